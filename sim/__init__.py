"""A world with known truth: terrain, a camera with a known lens, surveys."""
