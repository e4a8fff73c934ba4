"""Commands: each reads its settings, calls the library, prints and saves."""
