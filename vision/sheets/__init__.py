"""I(x, t) becomes x(n, t)."""
