"""Films, stills and the live page in a browser.

The figures of an evaluation are in `evaluation`.
"""
