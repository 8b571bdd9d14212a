// SPDX-License-Identifier: MIT
// Building block finite, reference stss_ref/arrays.py::require_finite: whether an array holds NaN or an infinity.
//
//  buffer  dir  shape     content
//  values  in   (count)   as bits
//  bad     out  (arrays)  `which` is set to 1 if one of them is not finite; the caller clears it
//
// Launch any number of work-items; each takes a contiguous part.
kernel void finite(global const uint *restrict values, const ulong count, global int *bad, const int which)
{
    uint largest = 0;  // without its sign, what is not finite has the largest bits of all
    const ulong part = (count + get_global_size(0) - 1) / get_global_size(0), first = get_global_id(0) * part;
    const ulong last = first + part < count ? first + part : count;
    for (ulong i = first; i < last; ++i) {
        const uint size = values[i] & 0x7fffffffu;
        largest = size > largest ? size : largest;
    }
    if (largest >= 0x7f800000u) atomic_or(bad + which, 1);
}
