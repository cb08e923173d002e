"""The verb ``experiment`` and its sub-verbs."""
