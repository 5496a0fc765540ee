"""The user's cache of libraries and traces, and the compiler that makes libraries."""
