"""Importers, a module for each format of files."""
