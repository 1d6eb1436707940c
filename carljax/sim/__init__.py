"""The driving simulator: towns, traffic, the ego, and what it sees."""
