"""Export of the collected data: tables for the analysis, also as a Psych-DS dataset."""
