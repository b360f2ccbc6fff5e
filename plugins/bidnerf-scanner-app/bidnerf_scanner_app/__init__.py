"""Reads folders of "All Data" as the iOS program "3D Scanner App" exports them."""

from bidnerf_scanner_app.reader import ScannerAppReader, reader

__all__ = ["ScannerAppReader", "reader"]
