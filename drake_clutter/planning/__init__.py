"""Motion planning for picking and placing: collision model, search, timing, optimization."""
