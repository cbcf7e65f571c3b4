"""Seeing policies: the same episode side by side, drawn offscreen for videos and live for a web page."""
