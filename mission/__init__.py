"""Pure flight geometry: numbers in, plan out."""
