"""The site of `staf docs`: its pages, how they are built, and the formulas on them."""
