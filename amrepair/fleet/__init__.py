"""Fleet: one process a printer, under a light supervisor with one page, a history and its chart.

A printer's process owns its port, its journal and its safe end; the supervisor owns none of them.
It starts, asks, stops and remembers, and decides nothing about a part.
"""
