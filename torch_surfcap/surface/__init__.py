"""From the field to the mesh and to pictures: extraction and rendering."""
