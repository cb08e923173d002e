"""The experimenter's pages: progress of the study, sessions, payments and export."""
