"""Tables of predictions and answers: read, checked and scored."""
