"""Plans on the command line: choice of models, and tables of tasks."""
