"""Export of the collected data: tables for the analysis, and the layouts Psych-DS and BIDS."""
