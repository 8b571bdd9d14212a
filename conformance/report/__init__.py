# SPDX-License-Identifier: MIT
"""What is kept and shown: failure folders, archives of cases, JSON, JUnit, pages."""
