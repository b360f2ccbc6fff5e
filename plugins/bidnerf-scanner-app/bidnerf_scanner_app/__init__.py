"""Reads "All Data" folders exported by the iOS app "3D Scanner App"."""

from bidnerf_scanner_app.reader import ScannerAppReader, reader

__all__ = ["ScannerAppReader", "reader"]
