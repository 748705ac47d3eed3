/* What this machine's memory gives, as the limit of sweeps and of building: compiled and called in the same run as they.
 *
 *     gcc -O3 -march=native -shared -fPIC bandwidth.c -o bandwidth.so
 */
#include <stdint.h>

/* out = a + 3 b, 24 bytes an entry, 32 where a written line is read first. */
void triad(const double *a, const double *b, double *out, int64_t start, int64_t stop)
{
    for (int64_t i = start; i < stop; i++) out[i] = a[i] + 3.0 * b[i];
}

/* The sum of values at indices that come one after another: a sweep that reads what it must, and does nothing else. */
double gather(const int32_t *indices, const double *values, int64_t start, int64_t stop)
{
    double sums[4] = {0, 0, 0, 0};
    int64_t i = start;
    for (; i + 4 <= stop; i += 4)
        for (int k = 0; k < 4; k++) sums[k] += values[indices[i + k]];
    for (; i < stop; i++) sums[0] += values[indices[i]];
    return sums[0] + sums[1] + sums[2] + sums[3];
}

/* Reads of a table at random places, 16 asked for at a time: what looking up a state costs at least. */
int64_t look_up(const int32_t *table, int64_t size, int64_t times)
{
    uint64_t state = 0x9E3779B97F4A7C15ull, places[16];
    int64_t sum = 0;
    for (int64_t i = 0; i < times; i += 16) {
        for (int k = 0; k < 16; k++) {
            state ^= state << 13, state ^= state >> 7, state ^= state << 17;
            places[k] = (uint64_t)(((unsigned __int128)state * (uint64_t)size) >> 64);
            __builtin_prefetch(table + places[k]);
        }
        for (int k = 0; k < 16; k++) sum += table[places[k]];
    }
    return sum;
}
