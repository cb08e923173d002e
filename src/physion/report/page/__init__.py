"""Page of a report."""
