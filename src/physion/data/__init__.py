"""Facts of the original study that ship with the package: scenes, outcomes, people, results."""
