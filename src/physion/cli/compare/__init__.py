"""The verb ``compare`` and its parts."""
