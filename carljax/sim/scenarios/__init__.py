"""The safety-critical scenarios: one file each, data for one small engine."""
