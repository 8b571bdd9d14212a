# SPDX-License-Identifier: MIT
"""The port protocol: the stages, their arrays, a port as an object, a port as a program."""

from conformance.protocol.job_folder import JobError, write_job
from conformance.protocol.port import Case, Port, PortError, Unsupported
from conformance.protocol.program_port import FolderPort
from conformance.protocol.stages import STAGES, reference

__all__ = ["STAGES", "Case", "FolderPort", "JobError", "Port", "PortError", "Unsupported", "reference", "write_job"]
