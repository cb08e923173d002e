"""The leaderboard: one table of many prediction files."""
