"""Photo files and what they say about themselves."""
