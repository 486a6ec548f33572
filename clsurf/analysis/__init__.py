"""What surfaces and scans tell about their shape: noise, curvature, lines, smoothing, error."""
