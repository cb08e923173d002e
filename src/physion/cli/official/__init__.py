"""Official data and files for the verbs, and the verb ``import-official``."""
