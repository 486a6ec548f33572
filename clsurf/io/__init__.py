"""Files: scans, surfaces and pictures in and out."""
