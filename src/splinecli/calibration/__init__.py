"""Light directions and strengths from photographs of mirror balls and of something gray."""
