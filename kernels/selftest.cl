// SPDX-License-Identifier: MIT
// Small tests of the properties that other kernels assume of a device; stss/devices/selftest.py has the right results.
//
//  buffer   dir  shape         meaning
//  a, b, c  in   (n,)          finite, b not 0, |c| < 80
//  values   out  (5, n)        a b + c, (a + b) + c, a / b, exp(c), sqrt(|a|)
//  whole    out  (3, n)        int of: a truncated, a rounded down, a as bits
//
// Launch (n) each; reduce_group in work-groups of GROUP.

// Two roundings, as in the reference: product and sum must not be fused.
#pragma OPENCL FP_CONTRACT OFF

#define GROUP 64

kernel void arithmetic(global const float *restrict a, global const float *restrict b, global const float *restrict c,
                       global float *restrict values, global int *restrict whole, const int n)
{
    const int i = get_global_id(0);
    if (i >= n) return;
    values[i] = a[i] * b[i] + c[i];
    values[n + i] = (a[i] + b[i]) + c[i];
    values[2 * n + i] = a[i] / b[i];
    values[3 * n + i] = exp(c[i]);
    values[4 * n + i] = sqrt(fabs(a[i]));
    whole[i] = (int)a[i];
    whole[n + i] = convert_int(floor(a[i]));
    whole[2 * n + i] = as_int(a[i]);
}

// Eight values at once: by an aligned pointer, and by vload8 one float further on; in (8 n + 8,), out (2, 8 n).
kernel void vectors(global const float *restrict in, global float *restrict out, const int n)
{
    const int i = get_global_id(0);
    if (i >= n) return;
    const float8 aligned = ((global const float8 *)in)[i];
    const float8 shifted = vload8(i, in + 1);
    ((global float8 *)out)[i] = aligned.s76543210;
    vstore8(shifted + aligned, i, out + 8 * n);
}

// Sum of each work-group by a tree in local memory: out[g] is right only if every barrier holds.
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void reduce_group(global const float *restrict in,
                                                                            global float *restrict out)
{
    local float part[GROUP];
    const int i = get_local_id(0);
    part[i] = in[get_global_id(0)];
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int half_of = GROUP / 2; half_of > 0; half_of /= 2) {
        if (i < half_of) part[i] += part[i + half_of];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (i == 0) out[get_group_id(0)] = part[0];
}

// The smallest wins, as in the splat: out[place[i]] = smallest key[i] among those with this place.
kernel void nearest(global const int *restrict place, global const int *restrict key, volatile global int *restrict out,
                    const int n)
{
    const int i = get_global_id(0);
    if (i < n) atomic_min(&out[place[i]], key[i]);
}

// Also built with -cl-mad-enable. Measures the speed of a convolution's inner loop: 4 accumulators of 8, 64 operations
// a step.
#pragma OPENCL FP_CONTRACT ON
kernel void speed(global const float8 *restrict weights, global float8 *restrict out, const int steps)
{
    const float x = (float)get_global_id(0);
    float8 p = 0.0f, q = 0.0f, r = 0.0f, s = 0.0f;
    for (int k = 0; k < steps; ++k) {
        const float8 w = weights[k];
        p += w * x;
        q += w * (x + 1.0f);
        r += w * (x + 2.0f);
        s += w * (x + 3.0f);
    }
    out[get_global_id(0)] = (p + q) + (r + s);
}
