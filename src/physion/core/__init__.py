"""Random numbers, errors, registries, files, settings and names, which all other rooms use."""
