"""What is in a trial."""
