"""What every other folder may import and what knows nothing of robots: errors, files, quaternions, the terminal.

Nothing here imports from another folder of the package.
"""
