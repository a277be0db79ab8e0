"""Pick-and-place planning: collision model, search, timing, optimization."""
