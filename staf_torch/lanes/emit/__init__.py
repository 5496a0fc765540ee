"""A scalar program as text: C++ with a row in every lane, C of one row, CUDA with a thread a row."""
