"""``tubesight compare``: all methods on identical pictures, judged by the truth."""
