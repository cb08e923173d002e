"""The official simulator's command logs become scenes."""
