"""clsurf: compact surface models from scans, drawn, traced, measured and cleaned on any OpenCL device."""
