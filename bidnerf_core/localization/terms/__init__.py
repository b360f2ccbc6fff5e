"""Terms of the sums that are minimized: measured points, rendered rays and whole images."""
