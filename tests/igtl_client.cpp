// Reads messages with the official OpenIGTLink library and prints one JSON object a line.
#include <cstdio>
#include <cstdlib>
#include <string>
#include "igtlClientSocket.h"
#include "igtlMessageHeader.h"
#include "igtlPointMessage.h"
#include "igtlPolyDataMessage.h"
#include "igtlStatusMessage.h"
#include "igtlStringMessage.h"
#include "igtlTransformMessage.h"

template <class Message> typename Message::Pointer take(igtl::Socket *socket, igtl::MessageHeader *header, bool &good)
{
  auto message = Message::New();
  message->SetMessageHeader(header);
  message->AllocatePack();
  bool timeout = false;
  socket->Receive(message->GetPackBodyPointer(), message->GetPackBodySize(), timeout);
  good = (message->Unpack(1) & igtl::MessageHeader::UNPACK_BODY) != 0;  // 1: check the checksum
  return message;
}

int main(int argc, char **argv)
{
  if (argc != 4) return 2;
  auto socket = igtl::ClientSocket::New();
  if (socket->ConnectToServer(argv[1], std::atoi(argv[2])) != 0) return 3;
  for (int left = std::atoi(argv[3]); left > 0; --left) {
    auto header = igtl::MessageHeader::New();
    header->InitPack();
    bool timeout = false, good = false;
    if (socket->Receive(header->GetPackPointer(), header->GetPackSize(), timeout) != header->GetPackSize()) return 4;
    header->Unpack();
    const std::string kind = header->GetDeviceType();
    auto time = igtl::TimeStamp::New();
    header->GetTimeStamp(time);
    std::printf("{\"kind\": \"%s\", \"device\": \"%s\", \"time_s\": %.6f, ", kind.c_str(), header->GetDeviceName(),
                time->GetTimeStamp());
    if (kind == "TRANSFORM") {
      auto m = take<igtl::TransformMessage>(socket, header, good);
      igtl::Matrix4x4 x;
      m->GetMatrix(x);
      std::printf("\"tip_mm\": [%.6f, %.6f, %.6f], \"z\": [%.6f, %.6f, %.6f]", x[0][3], x[1][3], x[2][3], x[0][2],
                  x[1][2], x[2][2]);
    } else if (kind == "POINT") {
      auto m = take<igtl::PointMessage>(socket, header, good);
      float p[3] = {0, 0, 0};
      if (good) {
        igtl::PointElement::Pointer last;
        m->GetPointElement(m->GetNumberOfPointElement() - 1, last);
        last->GetPosition(p);
      }
      std::printf("\"count\": %d, \"last_mm\": [%.6f, %.6f, %.6f]", m->GetNumberOfPointElement(), p[0], p[1], p[2]);
    } else if (kind == "POLYDATA") {
      auto m = take<igtl::PolyDataMessage>(socket, header, good);
      float p[3] = {0, 0, 0};
      int cell = 0;
      if (good) {
        m->GetPoints()->GetPoint(m->GetPoints()->GetNumberOfPoints() - 1, p);
        cell = m->GetLines()->GetCellSize(0);
      }
      std::printf("\"count\": %d, \"line\": %d, \"last_mm\": [%.6f, %.6f, %.6f]",
                  good ? m->GetPoints()->GetNumberOfPoints() : -1, cell, p[0], p[1], p[2]);
    } else if (kind == "STRING") {
      auto m = take<igtl::StringMessage>(socket, header, good);
      std::printf("\"text\": %s", m->GetString());
    } else if (kind == "STATUS") {
      auto m = take<igtl::StatusMessage>(socket, header, good);
      std::printf("\"code\": %d, \"name\": \"%s\"", m->GetCode(), m->GetErrorName());
    } else {
      return 5;
    }
    std::printf(", \"good\": %s}\n", good ? "true" : "false");
    std::fflush(stdout);
  }
  socket->CloseSocket();
  return 0;
}
