"""Judgement of generated movies: what moves in them, and whether red touches yellow."""
