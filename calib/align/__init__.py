"""Photos to Solution: features, tracks, block, adjustment."""
