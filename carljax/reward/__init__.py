"""The CaRL reward: one file for each term, composed in `reward`."""
