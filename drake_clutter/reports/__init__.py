"""HTML pages, pictures and tables of results."""
