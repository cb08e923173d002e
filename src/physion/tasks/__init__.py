"""Tasks for harnesses that ask language models."""
