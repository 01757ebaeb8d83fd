"""From triggers and photo files to photos with positions: pairing, interpolation, geotags."""
