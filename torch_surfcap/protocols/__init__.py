"""How published tables score: the surface protocol of DTU, and the table of scenes with their mean."""
