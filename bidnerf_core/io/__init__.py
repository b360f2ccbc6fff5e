"""Reading what users name, and writing whole files: text, JSON, images, arrays."""
