"""Linear and logistic mixed models with crossed random intercepts."""
