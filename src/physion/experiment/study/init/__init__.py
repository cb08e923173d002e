"""Creation of a study folder: selection of stimuli, their movies and maps."""
