"""The results of `infer` for a capture: files, report, maps and pages."""
