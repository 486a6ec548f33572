"""Reports: what a model and a view cost, as numbers and as a page."""
