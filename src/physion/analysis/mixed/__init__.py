"""Mixed models with crossed random intercepts."""
