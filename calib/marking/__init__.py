"""What a page to mark points by hand stands on: pictures in pieces, snapping, prediction, the file."""
