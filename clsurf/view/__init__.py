"""Looking at surfaces: a viewer of plain state and functions, and the canvases that show it."""
