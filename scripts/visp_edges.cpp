// ViSP's model-based edge tracker on one stereo pair, for compare_peers.py.
//
// Usage: visp_edges MODEL.cao LEFT.pgm RIGHT.pgm RANGE_PX   (needs ViSP, Debian: libvisp-mbt-dev)
//
// Standard input: fx fy cx cy of the left, then of the right camera; right_from_left, 16 numbers by
// rows; how many starts; each start's left_from_object, 16 numbers by rows (metres). Standard output, a
// line per start: milliseconds and left_from_object after ROUNDS rounds of tracking on the same pair, or
// "lost" where the tracker says so.

#include <chrono>
#include <cstdlib>
#include <iostream>
#include <map>
#include <string>

#include <visp3/core/vpImage.h>
#include <visp3/io/vpImageIo.h>
#include <visp3/mbt/vpMbGenericTracker.h>

// What moves the contour by more than the range of the search takes more rounds than one.
static const int ROUNDS = 5;

static vpHomogeneousMatrix pose() {
  vpHomogeneousMatrix m;
  for (unsigned i = 0; i < 4; i++)
    for (unsigned j = 0; j < 4; j++)
      std::cin >> m[i][j];
  return m;
}

static vpCameraParameters camera() {
  double fx, fy, cx, cy;
  std::cin >> fx >> fy >> cx >> cy;
  return vpCameraParameters(fx, fy, cx, cy);
}

int main(int argc, char **argv) {
  if (argc != 5) {
    std::cerr << "usage: visp_edges MODEL.cao LEFT.pgm RIGHT.pgm RANGE_PX\n";
    return 2;
  }
  vpImage<unsigned char> left, right;
  vpImageIo::read(left, argv[2]);
  vpImageIo::read(right, argv[3]);
  vpMe edges;
  edges.setMaskSize(5);
  edges.setMaskNumber(180);
  edges.setRange(std::atoi(argv[4]));
  edges.setThreshold(10000);
  edges.setMu1(0.5);
  edges.setMu2(0.5);
  edges.setSampleStep(4);
  const vpCameraParameters left_camera = camera(), right_camera = camera();
  const vpHomogeneousMatrix right_from_left = pose();
  int starts = 0;
  std::cin >> starts;
  for (int k = 0; k < starts; k++) {
    const vpHomogeneousMatrix start = pose();
    vpMbGenericTracker tracker(2, vpMbGenericTracker::EDGE_TRACKER);
    tracker.setMovingEdge(edges);
    tracker.setCameraParameters(left_camera, right_camera);
    tracker.setCameraTransformationMatrix(
        std::map<std::string, vpHomogeneousMatrix>{{"Camera1", vpHomogeneousMatrix()}, {"Camera2", right_from_left}});
    tracker.setAngleAppear(vpMath::rad(85));
    tracker.setAngleDisappear(vpMath::rad(89));
    tracker.loadModel(argv[1], argv[1]);
    try {
      tracker.initFromPose(left, right, start, right_from_left * start);
      const auto begin = std::chrono::steady_clock::now();
      for (int round = 0; round < ROUNDS; round++)
        tracker.track(left, right);
      const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - begin;
      vpHomogeneousMatrix found;
      tracker.getPose(found);
      std::cout << took.count();
      for (unsigned i = 0; i < 4; i++)
        for (unsigned j = 0; j < 4; j++)
          std::cout << ' ' << found[i][j];
      std::cout << std::endl;
    } catch (const vpException &) {
      std::cout << "lost" << std::endl;
    }
  }
}
