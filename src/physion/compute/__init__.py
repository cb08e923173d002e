"""Run many independent tasks."""
