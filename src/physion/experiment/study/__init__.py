"""The study folder: settings, texts, stimuli, media, recruitment."""
