"""What the command line tells about itself: examples and completion in the shell."""
