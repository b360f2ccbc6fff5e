"""Terms of the cost functions: measured points, rendered rays and whole images."""
