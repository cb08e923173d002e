"""Plans: all trainings, or all evaluations, of models x training protocols x scenarios x seeds."""
