"""Export in the layouts BIDS and Psych-DS."""
