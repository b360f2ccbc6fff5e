"""The page that shows a map and the localizations in it: as a file that needs no server, or live."""
