"""Execution of many independent tasks, in one process or several."""
