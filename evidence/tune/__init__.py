"""Tuning measured: is a budget kept on fresh sequences?"""
