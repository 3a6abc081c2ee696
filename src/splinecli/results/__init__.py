"""The results of `infer` for a capture: files, report, albedo, pages."""
