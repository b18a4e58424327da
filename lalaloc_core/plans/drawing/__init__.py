"""Vector drawings, whatever format they came in: which lines are walls, what they enclose, which symbols are doors."""
