"""The stability suite: inputs spoilt one way at a time, and what a fit makes of them. Used by train/stress.py."""
