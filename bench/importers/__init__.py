"""Importers: recordings of other systems, converted into recording folders."""
