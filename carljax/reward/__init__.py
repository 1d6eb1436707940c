"""Rewards: one file for each term, one for each reward made of them; `reward` chooses."""
