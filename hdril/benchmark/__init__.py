"""The engine of the benchmark: steps that are kept by what they are made from, the matrix of them, and what it says."""
