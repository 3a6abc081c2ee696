"""What `infer` leaves behind for a capture: files, albedo, pages."""
