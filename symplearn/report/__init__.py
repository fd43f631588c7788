"""What a diagnosis leaves behind: the files of its folder, and a few lines for the terminal."""

from ._directory import prepare_directory as prepare_directory
from ._html import html_report as html_report
from ._picture import before_after_picture as before_after_picture
from ._terminal import summary as summary
from ._write import write_outputs as write_outputs
