"""Show a running sensor in 3D Slicer: paste into its Python console. Needs the SlicerOpenIGTLink extension.

Start the sensor with ``tubesight live ... --igtl``. The tube and its tip appear in the 3-D view, in the tube's base
frame: put the nodes under a transform of your own registration to see them among images.
"""

import slicer

connector = slicer.vtkMRMLIGTLConnectorNode()
slicer.mrmlScene.AddNode(connector)
connector.SetName("tubesight")
connector.SetTypeClient("127.0.0.1", 18944)
connector.Start()


def show(caller: object = None, event: object = None) -> None:
    """Draw the curve as a tube, once its model has come."""
    model = slicer.mrmlScene.GetFirstNodeByName("Tube")
    if model is None:
        return
    if model.GetDisplayNode() is None:
        model.CreateDefaultDisplayNodes()
    display = model.GetDisplayNode()
    display.SetColor(0.25, 0.61, 1.0)
    display.SetLineWidth(6)
    tip = slicer.mrmlScene.GetFirstNodeByName("TipToBase")
    if tip is not None:
        tip.CreateDefaultDisplayNodes()
        tip.GetDisplayNode().SetVisibility(True)


connector.AddObserver(slicer.vtkMRMLIGTLConnectorNode.DeviceModifiedEvent, show)
