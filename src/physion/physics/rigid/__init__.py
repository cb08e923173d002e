"""The rigid-body engine: model of a scene, contact search, contact solver, sleep."""
