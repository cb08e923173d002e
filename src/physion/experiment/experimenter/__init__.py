"""The experimenter's pages: how the study goes, its sessions, payments and the export."""
