"""Drawing scenes at random: parameters, presets, placement of objects, camera and scenery."""
