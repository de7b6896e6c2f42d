"""Contents of the scene: glyphs, shapes, legends."""
