"""What stands in the scene: glyphs, shapes, legends."""
