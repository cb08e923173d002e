"""Tables of predictions and answers: readers, checks and scores."""
