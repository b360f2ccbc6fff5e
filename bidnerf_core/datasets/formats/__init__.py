"""The bundled readers, one format a file; each is registered by its name."""
