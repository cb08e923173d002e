"""What the lab does with a stored study: back it up, pause it, void sessions, move previews."""
