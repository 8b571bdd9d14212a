// SPDX-License-Identifier: MIT
// Stage rrm, reference stss_ref/rrm.py::rrm.
//
//  buffer     dir  shape   unit
//  valid      in   (H, W)  1 = can be trusted
//  rectangle  arg  int4    y, x, height, width; px, within the frame
//  masked     out  (H, W)  valid, 0 in the rectangle
//
// Build: no options.  Launch (W, H) rounded up.

kernel void rrm(global const uchar *restrict valid, global uchar *restrict masked, const int top, const int left,
                const int rows, const int columns, const int height, const int width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const bool within = y >= top && y < top + rows && x >= left && x < left + columns;
    masked[y * width + x] = within ? 0 : valid[y * width + x];
}
