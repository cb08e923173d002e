"""C-SWM: slots learned by contrast, and a graph network that predicts how they change."""
