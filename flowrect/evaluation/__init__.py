"""Evaluation in two passes: predictions to files, files to scores, scores to tables and a page."""
