// Attitude of a star camera by triangles of stars. adcs/stars/triangles.py prepares the triangles.
#pragma once
#include "adcs/rotation.hpp"
#include "magloc.h"

MAGLOC_BEGIN
struct TriangleAxes {
  Vector<double> along, middle, normal;  // of the longest side, across it towards the middle, and across both

  static TriangleAxes of(const Vector<double> (&corners)[3]) {
    const Vector<double> along = normalised(corners[1] - corners[0]), middle = corners[0] + corners[1] + corners[2];
    const Vector<double> across = normalised(middle - dot(middle, along) * along);
    return {along, across, cross(along, across)};
  }
};

// Direction of a star of an image, whose scale is by a factor another one; the camera looks along -z.
inline Vector<double> direction_of(const double *tangents, double scale) {
  return normalised(Vector<double>{{scale * tangents[0], scale * tangents[1], -1.0}});
}

// The rotation that takes the axes of one triangle to those of another one.
inline Matrix rotation_between(const TriangleAxes &from, const TriangleAxes &to) {
  Matrix R;
  for (int i = 0; i < 3; ++i)
    R.row[i] = to.along[i] * from.along + to.middle[i] * from.middle + to.normal[i] * from.normal;
  return R;
}

// Number from 0 to n - 1 of the cell of a value that is 0 to n; values beyond, and NaN, belong to the cells at the
// ends.
inline int64_t cell_of(double value, int64_t n) { return value > 0.0 ? value < (double)n ? (int64_t)value : n - 1 : 0; }

inline bool is_star_near(const magloc_star_triangles &p, const Vector<double> &v) {
  const double half = 0.5 * (double)p.n_cells, gate = p.star_gate;
  const auto cell = [&](double x) { return cell_of((x + 1.0) * half, p.n_cells); };
  for (int64_t i = cell(v[0] - gate); i <= cell(v[0] + gate); ++i)
    for (int64_t j = cell(v[1] - gate); j <= cell(v[1] + gate); ++j) {
      const int64_t row = (i * p.n_cells + j) * p.n_cells;
      for (int64_t k = p.sky_begins[row + cell(v[2] - gate)]; k < p.sky_begins[row + cell(v[2] + gate) + 1]; ++k) {
        const Vector<double> d = vector_at(p.sky + 3 * k) - v;
        if (dot(d, d) < gate * gate) return true;
      }
    }
  return false;
}

// How many stars of the image match with an attitude; less than `least` as soon as it cannot be more.
inline int64_t count_matches(const magloc_star_triangles &p, const Matrix &R, double scale, int64_t least) {
  int64_t matched = 0;
  for (int64_t i = 0; i < p.n_checked && matched + p.n_checked - i >= least; ++i)
    matched += is_star_near(p, R * direction_of(p.tangents + 2 * i, scale));
  return matched;
}

// First triangle of a cell, from begin on, whose longest side is not shorter.
inline int64_t first_not_shorter(const double *sides, int64_t begin, int64_t end, double longest) {
  while (begin < end) {
    const int64_t middle = (begin + end) / 2;
    if (sides[3 * middle + 2] < longest)
      begin = middle + 1;
    else
      end = middle;
  }
  return begin;
}

// Keep an attitude among the best ones, which are in ascending order; the worst of them is lost.
inline void keep_attitude(const magloc_star_triangles &p, int64_t count, const Matrix &R, double scale) {
  int64_t place = 0;
  for (; place < p.n_kept - 1 && p.matched[place + 1] < count; ++place) {
    p.matched[place] = p.matched[place + 1];
    p.scales[place] = p.scales[place + 1];
    for (int k = 0; k < 9; ++k) p.rotations[9 * place + k] = p.rotations[9 * (place + 1) + k];
  }
  p.matched[place] = count;
  p.scales[place] = scale;
  store(R, p.rotations + 9 * place);
}

// Try the attitude that triangle i of the image states by triangle k of the catalogue.
inline void try_attitude(const magloc_star_triangles &p, int64_t i, int64_t k) {
  const int64_t corners_that_match = 3;
  const double *seen = p.image_sides + 3 * i, *known = p.sides + 3 * k;
  const double ratio = (known[0] + known[1] + known[2]) / (seen[0] + seen[1] + seen[2]);
  const double at_most = ratio < 1.0 + p.scale_gate ? ratio : 1.0 + p.scale_gate;
  const double scale = maximum(at_most, 1.0 - p.scale_gate);
  Vector<double> in_image[3], in_sky[3];
  for (int c = 0; c < 3; ++c) {
    in_image[c] = direction_of(p.tangents + 2 * p.image_corners[3 * i + c], scale);
    in_sky[c] = vector_at(p.bright + 3 * p.corners[3 * k + c]);
  }
  const Matrix R = rotation_between(TriangleAxes::of(in_image), TriangleAxes::of(in_sky));
  const int64_t least = 1 + (p.matched[0] > corners_that_match ? p.matched[0] : corners_that_match);
  const int64_t count = count_matches(p, R, scale, least);
  if (count >= least) keep_attitude(p, count, R, scale);
}

// Try the attitudes that triangle i of the image states: its sides agree with those of a triangle of the catalogue in
// their ratios, in the order around it, and in scale.
inline void try_triangle(const magloc_star_triangles &p, int64_t i) {
  const double *seen = p.image_sides + 3 * i, longest = seen[2];
  const double first = seen[0] / longest, second = seen[1] / longest, gate = p.side_gate / longest;
  const double least = longest * (1.0 - p.scale_gate) - p.side_gate,
               most = longest * (1.0 + p.scale_gate) + p.side_gate;
  const auto cell = [&](double x) { return cell_of(x * (double)p.n_ratios, p.n_ratios); };
  for (int64_t row = cell(first - gate); row <= cell(first + gate); ++row)
    for (int64_t column = cell(second - gate); column <= cell(second + gate); ++column) {
      const int64_t *begin = p.begins + row * p.n_ratios + column;
      for (int64_t k = first_not_shorter(p.sides, begin[0], begin[1], least); k < begin[1]; ++k) {
        const double *known = p.sides + 3 * k;
        if (!(known[2] <= most)) break;
        const double off[2] = {known[0] / known[2] - first, known[1] / known[2] - second};
        if (p.is_counter_clockwise[k] != p.image_is_counter_clockwise[i]) continue;
        if (off[0] * off[0] + off[1] * off[1] > gate * gate) continue;
        ++p.progress[1];
        try_attitude(p, i, k);
      }
    }
}
MAGLOC_END
