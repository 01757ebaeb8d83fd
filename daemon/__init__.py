"""Everything that waits, listens or speaks: command line, and later link, capture, live status."""
