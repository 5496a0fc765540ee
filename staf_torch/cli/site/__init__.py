"""The site of `staf docs`: its pages and how they are built."""
