"""The sparse voxel field: its tiles, the module over them, and the visual hull it starts from."""
