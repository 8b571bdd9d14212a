// SPDX-License-Identifier: MIT
// Converts to half and back, as activations are stored and loaded: stss_cl/device/conversion.py tests a processor's
// instructions with it.
//
//  buffer    dir  shape     content
//  values    in   (8 n)     finite floats
//  narrowed  out  (8 n)     the nearest half, 65504 at most
//  widened   out  (8 n)     and its value
//
// Build -D STORED=HALF, optionally -D CONVERTS=X86 or PTX.  Launch (n).
#include "common.clh"

kernel void convert_half(global const float8 *restrict values, global stored *restrict narrowed,
                         global float8 *restrict widened)
{
    const int i = get_global_id(0);
    STORE8(values[i], i, narrowed);
    widened[i] = LOAD8(narrowed, i);
}
