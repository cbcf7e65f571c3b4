"""What the page of `make report` says and shows: which files belong to it, its facts, its films and its template.

The numbers come from `evaluation`, the verdict from `attacks`; the command with its options is `report.py` at the top.
"""
