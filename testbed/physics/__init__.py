"""The Earth, rotations, the atmosphere and the interpolation of motion: kernels on numbers that are float64 or lanes."""
