"""Reading files that users name, and writing whole files: text, JSON, images, arrays."""
