"""Report pages: the only package that draws."""
