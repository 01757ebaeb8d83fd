"""What is true about a camera: photos in, calibration and judgement out. Knows no vehicle."""
