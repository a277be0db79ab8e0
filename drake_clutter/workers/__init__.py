"""Maps a function over many items in several processes, here or on a cluster."""
