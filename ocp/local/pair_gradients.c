/* What is around the pairs of a machine whose distances are worked out in C: exponentials that compilers make vector
   instructions of, results in their places, soft minima. The rest of the text is made by ocp/local/pair_gradients.py. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define EACH \
  for (int side = 0; side < sides; ++side) \
    for (int l = SIDE * side; l < SIDE * side + SIDE; ++l)
#define SHIFT 6755399441055744.0 /* 1.5 * 2^52: behind it the last bits of a number count its ones */
#define LN2 0.69314718055994530942
#define LN2_HIGH 6.93147180369123816490e-01 /* 32 bits of it: n times this is exact */
#define LN2_LOW 1.90821492927058770002e-10

static inline uint64_t bits_of(double x) {
  uint64_t bits;
  memcpy(&bits, &x, sizeof bits);
  return bits;
}

static inline double of_bits(uint64_t bits) {
  double x;
  memcpy(&x, &bits, sizeof x);
  return x;
}

/* e^x to two units in the last place, held within what a double holds: 2^n e^r, |r| at most log(2)/2. */
static inline double exponential(double x) {
  x = x < -708.0 ? -708.0 : x;
  x = x > 709.0 ? 709.0 : x;
  const double t = x * (1.0 / LN2) + SHIFT, n = t - SHIFT, r = (x - n * LN2_HIGH) - n * LN2_LOW;
  double p = 1.0 / 6227020800.0;
  p = p * r + 1.0 / 479001600.0;
  p = p * r + 1.0 / 39916800.0;
  p = p * r + 1.0 / 3628800.0;
  p = p * r + 1.0 / 362880.0;
  p = p * r + 1.0 / 40320.0;
  p = p * r + 1.0 / 5040.0;
  p = p * r + 1.0 / 720.0;
  p = p * r + 1.0 / 120.0;
  p = p * r + 1.0 / 24.0;
  p = p * r + 1.0 / 6.0;
  p = p * r + 0.5;
  p = p * r + 1.0;
  p = p * r + 1.0;
  return p * of_bits((bits_of(t) + 1023) << 52);
}

/* The logarithm of a positive number, to two units in the last place: n log 2 + 2 artanh s, |s| at most 1/3. */
static inline double logarithm(double x) {
  const uint64_t bits = bits_of(x);
  const double n = of_bits((bits >> 52) + bits_of(SHIFT)) - (SHIFT + 1023.0);
  const double m = of_bits((bits & 0xfffffffffffffull) | 0x3ff0000000000000ull);
  const double low = m > 1.41421356237309504880 ? 0.5 * m : m, k = m > 1.41421356237309504880 ? n + 1.0 : n;
  const double s = (low - 1.0) / (low + 1.0), z = s * s;
  double p = 1.0 / 21.0;
  p = p * z + 1.0 / 19.0;
  p = p * z + 1.0 / 17.0;
  p = p * z + 1.0 / 15.0;
  p = p * z + 1.0 / 13.0;
  p = p * z + 1.0 / 11.0;
  p = p * z + 1.0 / 9.0;
  p = p * z + 1.0 / 7.0;
  p = p * z + 1.0 / 5.0;
  p = p * z + 1.0 / 3.0;
  p = p * z;
  return k * LN2_HIGH + (2.0 * s + (2.0 * s * p + k * LN2_LOW)) + (x - x); /* what is no number stays none */
}

/* Entries of columns of shapes, side by side: of rows `at` of those of a kind, at most TILE. */
static inline void gather(const double *column, int rows, int entries, const int *at, int count, double *to) {
  for (int e = 0; e < entries; ++e)
    for (int k = 0; k < count; ++k) to[e * TILE + k] = column[e * rows + at[k]];
}

/* Results, one row a number and `width` numbers a pair, to their pairs: runs of (first, row, length). */
static inline void spread(const double *from, int width, const int (*run)[3], int runs, double *value, double *slope,
                          int rows, int columns) {
  for (int r = 0; r < runs; ++r)
    for (int j = 0; j <= columns; ++j) {
      const double *given = from + j * width + run[r][0];
      double *to = (j ? slope + (j - 1) * rows : value) + run[r][1];
      for (int i = 0; i < run[r][2]; ++i) to[i] = given[i];
    }
}

/* The soft minimum of some pairs in a row, and its slopes; the values become their shares in it. */
static inline void soften(double *value, const double *slope, int rows, int count, int columns, double softness,
                          double *to, double *slope_to, int rows_to) {
  double least = value[0], whole = 0.0;
  for (int i = 1; i < count; ++i) least = value[i] < least ? value[i] : least;
  for (int i = 0; i < count; ++i) whole += value[i] = exp((least - value[i]) / softness);
  *to = least - softness * log(whole);
  for (int i = 0; i < count; ++i) value[i] /= whole;
  for (int j = 0; j < columns; ++j) {
    double sum = 0.0;
    for (int i = 0; i < count; ++i) sum += value[i] * slope[j * rows + i];
    slope_to[j * rows_to] = sum;
  }
}
