"""The fit: full gradient descent over levels, coarse to fine."""
