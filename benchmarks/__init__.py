"""Campaigns and side-by-side timings; their results stand beside them."""
